"""The live page: inputs and results of the fusion node in a browser, and finished jobs."""
