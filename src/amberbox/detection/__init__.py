"""Detection: learns what is normal from nominal missions, and notices what is not."""
