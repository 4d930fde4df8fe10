from pipeline.learning import stopwatch


def test_a_call_is_timed_after_one_that_warms_and_the_middle_time_counts(monkeypatch):
    now_s, calls = [0.0], []

    def call() -> None:
        calls.append(len(calls))
        now_s[0] += 1000.0 if len(calls) == 1 else float(len(calls))  # cold once, then 2 s, 3 s, ...

    monkeypatch.setattr(stopwatch, "perf_counter", lambda: now_s[0])
    median_s = stopwatch.median_s(call)
    assert len(calls) == stopwatch.REPEATS_N + 1
    assert median_s == (2 + stopwatch.REPEATS_N + 1) / 2  # of 2 .. 26 s


def test_one_slow_call_changes_little(monkeypatch):
    now_s, took_s = [0.0], iter([1.0] * 10 + [500.0] + [1.0] * stopwatch.REPEATS_N)

    def call() -> None:
        now_s[0] += next(took_s)

    monkeypatch.setattr(stopwatch, "perf_counter", lambda: now_s[0])
    assert stopwatch.median_s(call) == 1.0
