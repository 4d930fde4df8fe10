"""One thin module a DVC stage: read argv and params, read inputs, call one or two functions, write.

Refuses to know arithmetic: what a stage computes stands in the folder that it calls.
"""
