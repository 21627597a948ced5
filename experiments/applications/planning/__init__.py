"""Planning in a simulator: which actions bring its pictures nearest to a goal.

`cem`, `mppi` and `shooting` search over sequences of actions and know nothing of simulators; `models` say what would be
seen under many of them at once, in the learned simulator or in the true one; `goals` what a picture is worth; `control`
plans again while the plan is carried out.
"""
