"""Pictures for people: grasps, portraits, and the sheets that show them."""
