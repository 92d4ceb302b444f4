"""Tables, claims and the replication report."""
