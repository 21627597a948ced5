"""Whether policies that succeed in the learned simulator succeed in the true one (the paper's Table 5).

`head` is a success detector on frames, `rollouts` runs a policy in either world, `outcomes` is the table of successes,
`agreement` correlates the worlds, `ladder` trains policies of different strength, `user_policies` loads the user's,
`ground_truth` gives starts, labels of success and the true simulator, `recordings` the same for robots without one,
`real` reads success counts of the real robot. `judge` puts these together, `page` and `blind` show the result.
"""
