"""Model-predictive control with a simulator: which actions bring its frames nearest to a goal image.

`cem`, `mppi` and `shooting` search over sequences of actions and know nothing of simulators; `models` roll out many
sequences at once, in the learned simulator or in the true one; `goals` is the cost of the frames; `control` replans
while actions are executed.
"""
