"""Set-up: the record of the experiment, the safety list, and the bench."""
