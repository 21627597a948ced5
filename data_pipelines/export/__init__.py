"""Writing any `EpisodeSource` in a format that other programs train on."""
