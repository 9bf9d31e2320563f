"""Checks of a log before it is trusted: what `fathom inspect` prints and draws.

- `findings`: what a check returns (measured facts, findings with their fix, a panel) and how panels look.
- `streams`: checks of one stream by itself: rates, gaps, stuck or coarse values, outliers, gravity, noise.
- `between`: checks of two sensors that see the same motion: clocks, mountings, scales, offsets, lever arms.
- `inspecting` opens a log and runs every check; `page` prints and draws the result; `contents` lists the messages of
  a recording that has no log.yaml yet.

`inspecting` and `page` import the three folders. `streams` and `between` import `findings`, and not each other.
"""
