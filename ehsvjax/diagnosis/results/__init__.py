"""What a person sees: the diagnosis, its tables, words, pictures and page."""
