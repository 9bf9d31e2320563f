"""Results of runs: the store, the identity of a run, summaries, intervals and paired differences."""
