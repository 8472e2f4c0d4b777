"""Evidence of the scans of a drive for its paths, without a ground truth."""
