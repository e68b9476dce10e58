"""One thread for the linear algebra of searches."""

from threadpoolctl import ThreadpoolController

from jaxmpc.programs.linear_algebra import one_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info()}


def test_searches_that_overlap_take_one_thread_and_the_last_to_end_gives_the_others_back():
    before, first, second = threads(), one_thread(), one_thread()
    with first:
        assert threads() == {1}
        second.__enter__()
    assert threads() == {1}
    second.__exit__(None, None, None)
    assert threads() == before
