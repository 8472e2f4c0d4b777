"""Map over map in a browser: the scene that a page shows and the front end that draws it."""
