"""The printed results of the four papers, one folder a paper and one file a printed table or figure."""
