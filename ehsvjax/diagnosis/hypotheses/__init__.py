"""What could be there, and what it would do: candidates, frequencies, terms of free form, a random force."""
