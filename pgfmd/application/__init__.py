"""Result folders: their schema, written whole or not at all, and read without MPI."""
