"""RLDS, read and written without TensorFlow: shards, records, features, images, on a disk or in an object store."""
