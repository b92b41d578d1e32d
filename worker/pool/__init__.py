"""Pool of processes, for work that threads of one process cannot distribute over many cores."""
