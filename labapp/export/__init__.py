"""Export of results: tables, meshes, HDF5, pictures, films, and folders of all these."""
