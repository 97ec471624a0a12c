"""Requirements: what must be seen on which ground around the vehicle, and what cameras see of it."""
