"""The comparison of a result with the ground truth: alignment, matches, and errors as numbers and as a table. The folder
`results` reads the results, and the folder `output` draws them."""
