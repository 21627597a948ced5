"""The machine a program runs on: devices, meshes, memory."""
