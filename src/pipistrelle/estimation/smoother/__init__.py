"""The smoother: `filter` is the method, `graph` the factor graph, `belief` what it answers."""
