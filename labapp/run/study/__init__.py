"""Studies: many recordings, measured on all cores or a cluster, and compared (`Study`)."""
