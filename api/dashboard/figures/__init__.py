"""What pages draw: charts, matrices and maps, as SVG and tables."""
