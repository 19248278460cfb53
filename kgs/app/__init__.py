"""The application on the library: the command `kgs`, folders of results, pages. Only `kgs.study` imports it."""
