"""Estimate the errors that all measurements share and the noise of the measurements, around a joint solve or at fixed poses."""
