"""Numbers and tables as words, and what is written to the terminal; imports no other folder of experiments."""
