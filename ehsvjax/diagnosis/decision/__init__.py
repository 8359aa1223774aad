"""Which explanation stands: the search, rivals, prediction, tests of what is left, the verdict."""
