"""What the search reads: a drive on an even grid, parameter vectors, free runs of the model."""
