"""Reading and writing of files: meshes, scans, arrays, image headers, private files, objects on S3 servers."""
