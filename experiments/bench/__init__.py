"""`hma bench`: how fast things are, in records that say on what hardware, how, and compared with what.

Every record holds the naive path beside the fast one, measured alternately in the same process: on shared machines a
ratio within one run is meaningful, a single number rarely is.
"""
