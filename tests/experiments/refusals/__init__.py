"""What a user meets when data, directories or checkpoints are wrong: one message that says what, where and what to do,
an exit code, and no traceback.

All of it goes through `main`, on tiny RLDS datasets under registered names. No step here learns anything: what a step
computes is tested elsewhere.
"""
