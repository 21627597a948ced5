"""How long a learned simulator stays close to the true one under the same actions, over minutes (drift of rollouts).

`drives` makes actions and true rollouts, `films` measures the frames of both simulators, `hidden` tests objects that
come back into view, `tables` and `figures` summarise the measures.
"""
