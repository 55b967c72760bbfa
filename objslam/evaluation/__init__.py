"""Align and match a result with the ground truth, and compute its errors as numbers and as a table. The folder `results`
reads the results, and the folder `output` draws them."""
