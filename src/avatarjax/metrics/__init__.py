"""What a result is worth: image quality, responsiveness to keys, drift, and the report that shows it."""
