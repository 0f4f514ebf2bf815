"""What is written of results: tables, meshes, HDF5, pictures, films, whole folders of them."""
