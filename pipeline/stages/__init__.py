"""One thin module a DVC stage: read argv and params, read inputs, call one or two functions, write."""
