"""Bad input by the thousand: mutants of good files, and a corpus of what has once gone wrong."""
