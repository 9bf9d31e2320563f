"""The command line: one file per verb, shared options in `options`, refusals in `verb`, all of it together in `app`."""
