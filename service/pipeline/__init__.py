"""What becomes of jobs and datasets: actions of users, and the keeper that carries them out."""
