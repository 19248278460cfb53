"""The application on the library: the command `kgs`, folders of results, pages. No module outside it imports it."""
