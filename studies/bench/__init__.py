"""`jaxmpc bench`: our solvers and other people's on the same recorded samples, in one table.

`run` goes through the sections; `instances` records the samples; `peers` are the other solvers, `forms` their matrices,
`problem` the independent judge; `rows` prints and writes what came out.
"""
