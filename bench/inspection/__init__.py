"""Checks of a log before it is trusted: what `fathom inspect` prints and draws.

- `findings`: what a check returns (measured facts, findings with their fix, a panel), least squares with honest
  uncertainties, fixes as lines of log.yaml, and how panels look.
- `streams`: checks of one stream by itself: rates, gaps, stuck or coarse values, outliers, gravity, noise.
- `between`: checks of two sensors that see the same motion: clocks, mountings, scales, offsets, lever arms.
- `gross`: faults so large that streams contradict each other, in milliseconds; alone, the check before an experiment.
- `inspecting` opens a log and runs every check; `page` prints and draws the result; `contents` lists the messages of
  a recording that has no log.yaml yet.

`inspecting` and `page` import all folders. `between` and `gross` import `streams` and `findings`, and not each other.
"""
