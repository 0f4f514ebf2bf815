"""What is kept: the setup of the bench, and everything a measurement leaves on disk."""
