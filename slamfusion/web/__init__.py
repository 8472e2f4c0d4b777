"""Map over map in a browser: the scene that a page shows, its front end, and the live page."""
