"""gmapping [G07]: a particle filter over paths, each particle with a map of its own."""
