"""Tests of chip faults in synthetic and in real recordings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin import seeds
from reskin.board import chips, faults

NOISE_uT = 5.0  # The noise of real boards is 3.0 to 5.0 uT.
GRIDS_uT = {"ini": (0.15, 0.242), "lab": (0.2, 0.3227), "eflesh": (2.4, 3.872), "eflesh shear": (0.6, 0.968)}


def readings_on_grid(
    lsb_uT: list[tuple[float, float]], frames_n: int, seed: int, *, noise_uT: float = 5.0
) -> np.ndarray:
    """Return noisy fields of chips with the given steps (xy, z).

    They are rounded to two decimals, as the firmware that writes text does.
    """
    rng = seeds.rng_for(seed, "faults")
    step_uT = np.array([[xy, xy, z] for xy, z in lsb_uT]).reshape(-1)
    field_uT = rng.uniform(-3000, 3000, len(step_uT)) + NOISE_uT * rng.standard_normal((frames_n, len(step_uT)))
    return (np.round(field_uT / step_uT) * step_uT).round(2)


def load_ini(shared_data, name: str, rows: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    values = np.loadtxt(shared_data / "ini" / name)[rows].reshape(-1, 5, 4)
    return values[..., :3].reshape(-1, 15), values[..., 3]


class TestFailedReads:
    def test_read_failed_only_if_temperature_and_all_three_fields_are_error_values(self):
        b_uT = np.tile([8028.16, 5194.00, 12943.36], 3)[None]
        temperature_degC = np.array([[-880.49, -880.49, 25.0]])
        b_uT[0, 4] = 5194.2
        assert faults.failed_reads(b_uT, temperature_degC).tolist() == [[True, False, False]]

    def test_failed_read_without_a_temperature_is_recognised_by_its_fields(self):
        b_uT = np.array([[8028.16, 5194.00, 12943.36, 1.0, 2.0, 3.0]])
        assert faults.failed_reads(b_uT, np.full((1, 2), np.nan)).tolist() == [[True, False]]

    def test_real_recording_of_failed_reads_is_recognised(self, shared_data):
        assert faults.failed_reads(*load_ini(shared_data, "faults/b20_artillery_AFG_flex_50.head400.txt")).all()

    def test_no_fault_is_found_on_a_real_working_board(self, shared_data):
        assert not faults.failed_reads(*load_ini(shared_data, "b20_artillery_AFG_board2_50_screw.txt")).any()


class TestZeroReads:
    def test_read_counts_as_zero_only_if_all_three_fields_are_zero(self):
        b_uT = np.array([[0.0, 0.0, 0.0, 0.0, 5.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
        assert faults.zero_reads(b_uT).tolist() == [[True, False], [False, True]]

    @pytest.mark.parametrize(
        ("name", "zeros_n"), [("position_1_20251028_003401", 18), ("multi_touch_1_2_20251109_230349", 61)]
    )
    def test_zero_reads_of_real_recordings_are_counted(self, shared_data, name, zeros_n):
        table = np.genfromtxt(shared_data / f"eflash7/{name}.csv", delimiter=",", skip_header=1)
        zeros = faults.zero_reads(table[:, -15:])
        assert zeros.all(axis=1).sum() == zeros.any(axis=1).sum() == zeros_n

    def test_no_fault_is_found_on_real_working_boards(self, shared_data):
        assert not faults.zero_reads(load_ini(shared_data, "b20_artillery_AFG_board2_50_screw.txt")[0]).any()
        for file in (shared_data / "lab").glob("*.csv"):
            table = np.genfromtxt(file, delimiter=",", names=True)
            b_uT = np.stack([table[f"B{axis}{chip}"] for chip in range(5) for axis in "xyz"], axis=1)
            assert not faults.zero_reads(b_uT).any()


class TestScale:
    @given(st.sampled_from(sorted(GRIDS_uT)), st.integers(0, 1000))
    def test_find_lsb_returns_the_step_of_rounded_readings(self, name, seed):
        # The tolerance is 2 %, because rounding to two decimals changes a step of 0.15 uT by at most 2 %, and a mean of
        # steps by less.
        lsb_uT = faults.find_lsb(readings_on_grid([GRIDS_uT[name]], 400, seed))
        np.testing.assert_allclose(lsb_uT, [GRIDS_uT[name]], rtol=0.02)

    @given(st.integers(0, 1000))
    def test_find_lsb_returns_nan_for_values_that_were_not_rounded(self, seed):
        field_uT = 5.0 * seeds.rng_for(seed, "smooth").standard_normal((400, 6))
        assert np.isnan(faults.find_lsb(field_uT)).all()
        assert not faults.reset_chips(faults.find_lsb(field_uT), None).any()

    @given(st.sampled_from(sorted(GRIDS_uT)), st.integers(0, 4), st.integers(0, 1000))
    def test_chip_with_power_on_settings_is_found(self, name, chip_i, seed):
        grids_uT = [GRIDS_uT[name]] * 5
        grids_uT[chip_i] = (chips.RESET_LSB_XY_uT, chips.RESET_LSB_Z_uT)
        b_uT = readings_on_grid(grids_uT, 400, seed)
        expected = [i == chip_i for i in range(5)]
        assert faults.reset_chips(faults.find_lsb(b_uT), None).tolist() == expected
        assert faults.reset_chips(faults.find_lsb(b_uT), GRIDS_uT[name]).tolist() == expected

    def test_step_at_power_on_is_accepted_if_it_is_expected(self):
        grid_uT = (chips.RESET_LSB_XY_uT, chips.RESET_LSB_Z_uT)
        b_uT = readings_on_grid([grid_uT] * 5, 400, 0)
        assert faults.reset_chips(faults.find_lsb(b_uT), None).all()
        assert not faults.reset_chips(faults.find_lsb(b_uT), grid_uT).any()

    def test_chips_with_power_on_settings_in_real_recordings_are_found(self, shared_data):
        one_chip, _ = load_ini(shared_data, "faults/b20_artillery_AFG_test_new_board15.head400.txt")
        all_chips, _ = load_ini(shared_data, "faults/b20_artillery_piezo.head400.txt")
        assert faults.reset_chips(faults.find_lsb(one_chip), None).tolist() == [False, False, False, True, False]
        assert faults.reset_chips(faults.find_lsb(one_chip), GRIDS_uT["ini"]).tolist() == [
            False,
            False,
            False,
            True,
            False,
        ]
        assert faults.reset_chips(faults.find_lsb(all_chips), None).all()

    def test_no_fault_is_found_on_real_working_boards(self, shared_data):
        b_uT, _ = load_ini(shared_data, "b20_artillery_AFG_board2_50_screw.txt", slice(0, 8000))
        for first in range(0, len(b_uT), 400):
            assert not faults.reset_chips(faults.find_lsb(b_uT[first : first + 400]), None).any()
        for file in sorted((shared_data / "lab").glob("*.csv")):
            b_uT = np.loadtxt(file, delimiter=",", skiprows=1, usecols=[5, 6, 7, 9, 10, 11], max_rows=800)
            assert not faults.reset_chips(faults.find_lsb(b_uT), None).any()
            np.testing.assert_allclose(faults.find_lsb(b_uT), [GRIDS_uT["lab"]] * 2, rtol=0.02)


def stuck_chips(b_uT: np.ndarray) -> np.ndarray:
    """Mark the readings of stuck chips in a whole recording."""
    return faults.StuckChips(b_uT.shape[1] // 3).feed(b_uT)


class TestStuck:
    def stuck_naively(self, b_uT: np.ndarray) -> np.ndarray:
        """Return the reference: for each reading, walk back over equal readings.

        On the way, count the frames in which another chip changed.
        """
        frames_n, chips_n = len(b_uT), b_uT.shape[1] // 3
        rows = b_uT.reshape(frames_n, chips_n, 3)
        stuck = np.zeros((frames_n, chips_n), bool)
        for chip_i in range(chips_n):
            for frame_i in range(frames_n):
                first, moved_n = frame_i, 0
                while first > 0 and (rows[first - 1, chip_i] == rows[frame_i, chip_i]).all():
                    moved_n += (rows[first - 1] != rows[first]).any()
                    first -= 1
                run_n = frame_i - first + 1
                stuck[frame_i, chip_i] = run_n >= faults.STUCK_FRAMES_MIN_N and moved_n >= faults.OTHERS_MOVE_MIN * (
                    run_n - 1
                )
        return stuck

    @given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 45)), max_size=6), st.integers(1, 2))
    def test_stuck_chips_equal_those_found_by_a_loop(self, stretches, chips_n):
        """The readings consist of stretches, in each of which some chips change from frame to frame.

        Chip 0 changes if bit 0 of the first number of the stretch is set, and chip 1 if bit 1 is set.
        """
        moves = np.array([[which & 1, which >> 1] for which, frames_n in stretches for _ in range(frames_n)])
        places = moves.reshape(-1, 2)[:, :chips_n].cumsum(axis=0)
        b_uT = np.repeat(places, 3, axis=1).astype(np.float32)
        np.testing.assert_array_equal(stuck_chips(b_uT), self.stuck_naively(b_uT))

    @given(st.lists(st.integers(0, 200), max_size=4))
    def test_stuck_chips_do_not_depend_on_the_chunks_that_are_fed(self, ends):
        b_uT = readings_on_grid([GRIDS_uT["ini"]] * 2, 200, 0)
        b_uT[60:150, 3:6] = b_uT[60, 3:6]
        detector = faults.StuckChips(2)
        parts = [detector.feed(part) for part in np.split(b_uT, sorted(ends))]
        np.testing.assert_array_equal(np.concatenate(parts), stuck_chips(b_uT))

    def test_chip_counts_as_stuck_from_its_20th_equal_reading_on(self):
        b_uT = readings_on_grid([GRIDS_uT["ini"]] * 3, 200, 0)
        b_uT[120:, 3:6] = b_uT[120, 3:6]
        expected = np.zeros((200, 3), bool)
        expected[120 + faults.STUCK_FRAMES_MIN_N - 1 :, 1] = True
        np.testing.assert_array_equal(stuck_chips(b_uT), expected)

    def test_board_on_which_no_chip_changes_does_not_count_as_stuck(self):
        assert not stuck_chips(np.ones((100, 15))).any()

    def test_no_fault_is_found_on_a_real_working_board(self, shared_data):
        b_uT, _ = load_ini(shared_data, "b20_artillery_AFG_board2_50_screw.txt")
        assert not stuck_chips(b_uT).any()


def test_readings_while_a_press_begins_are_no_jumps_but_cut_digits_are():
    rng = np.random.default_rng(1)
    shape = np.repeat(rng.uniform(100.0, 700.0, 15)[None], 60, axis=0) * rng.choice([-1.0, 1.0], 15)
    begin = np.concatenate([np.zeros(20), [0.35, 0.9], np.ones(16), [0.8, 0.4], np.zeros(20)])
    b_uT = 1000.0 + begin[:, None] * shape + 3.0 * rng.standard_normal((60, 15))
    b_uT[:, 4] = 1000.0 + np.where(begin > 0, 55.0, 0.0)
    b_uT[[21, 38], 4] += 65.0  # overshoots, as a chip does whose field turns while the tip goes down
    assert not faults.lone_jumps(b_uT).any()
    cut = b_uT.copy()
    cut[10, 2], cut[30, 7], cut[50] = 100.0, -3.0, b_uT[50] / 10  # one channel at rest and in the press; a whole line
    assert np.flatnonzero(faults.lone_jumps(cut)).tolist() == [10, 30, 50]
