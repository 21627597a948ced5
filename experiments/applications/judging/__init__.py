"""Whether policies that succeed in the learned simulator succeed in the true one (the paper's Table 5).

`head` tells success from frames, `rollouts` runs a policy in either world, `outcomes` is the table of what came of it,
`agreement` compares the worlds, `ladder` makes the policies, `own_policies` takes a user's, `outside` gives what is not
the model's: where episodes begin, what success looks like, the truth; `recordings` does so without a true simulator,
`real` has what was counted on the real robot. `judge` puts these together, `page` and `blind` show it.
"""
