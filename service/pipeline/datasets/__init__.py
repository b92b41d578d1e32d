"""Datasets: a matrix of hands x objects, each cell one ordinary job."""
