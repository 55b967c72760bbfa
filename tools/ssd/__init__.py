"""A compact SSD (Liu et al. 2016) for the seven objects: data, model, loss, evaluation and export, for training only."""
