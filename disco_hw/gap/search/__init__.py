"""Which effects are missing: fits, evidence, selection, held-out predictions."""
