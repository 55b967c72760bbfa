"""Compare a result with the ground truth. The steps are the alignment, the matches, and the errors as numbers and tables.
`io.results` reads the results."""
