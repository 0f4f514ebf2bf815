"""The configuration adviser: positions of laser and imaging plane for the expected pools."""
