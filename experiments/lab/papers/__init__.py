"""Reproductions of the four papers: one folder per paper, one file per printed table or figure."""
