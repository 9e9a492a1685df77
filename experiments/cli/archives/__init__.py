"""Archives of recordings: thousands of folders, tracked and evaluated one by one, with one table of results."""
