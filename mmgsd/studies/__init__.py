"""The studies: what is trained and asked, and what comes of it."""
