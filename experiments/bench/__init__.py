"""`hma bench`: how fast things are, as records that say on what, how, and against what.

Every record holds the naive path beside the fast one, measured by turns in the same process: on
shared machines a ratio within one run means something, a number alone rarely does.
"""
