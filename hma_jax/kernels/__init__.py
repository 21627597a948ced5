"""What knows platforms: attention and linear maps, computed as each backend does it best."""
