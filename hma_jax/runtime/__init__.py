"""The machine and its operating system: devices, meshes, sharding, processes, locks, files, memory, exit codes."""
