"""Datasets: a matrix of hands x objects; each cell is an ordinary job."""
