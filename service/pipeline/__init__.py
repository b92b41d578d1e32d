"""What becomes of jobs and datasets: actions of users, and the controller that carries them out."""
