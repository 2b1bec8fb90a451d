"""Scripts that run where a program of others is installed. They import nothing of this project."""
