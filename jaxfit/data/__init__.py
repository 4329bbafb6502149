"""The host side: files, pictures, boxes and crops; the only place that touches OpenCV and the disk."""
