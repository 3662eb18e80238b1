"""The black box: sources in, journals and columns out."""
