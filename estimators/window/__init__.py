"""The smoother on our own solver: options, pass, compiled steps, factors, chain; derived in docs/window.md."""
