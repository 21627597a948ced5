"""Atomic, resumable creation of outputs that take long to make: datasets, token stores, trials.

Owns the one scheme that tokens, conversions, the suite and the simulators share; knows nothing of what is made.

* `output_lock`: one process at a time makes an output. The lock file lies beside it and ends with its process;
  others wait, or do something else. Who holds the lock removes the scratch directories that dead holders left.
* `files`: an output is written to a temporary directory, synced, and renamed into place. Readers see all of it or
  nothing.
* `fingerprint`: a hash of everything the bytes depend on, stored in the output. An output that is complete and has
  the expected fingerprint is kept.
* `journal`: which steps of an output are finished, so that a restarted process continues after the last of them.

`hma_jax.runtime.locks` says what a lock guarantees on which file system. Where it fails, on a shared disk without
locks after the lease ran out, two processes make the same output: both write equal bytes to scratch directories of
their own and rename them, so that only time is lost.
"""
