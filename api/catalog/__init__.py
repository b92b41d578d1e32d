"""What routes and pages read and do, as documents."""
