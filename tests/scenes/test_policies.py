"""Which frames models are shown, counted by hand for a clip of 50 frames at 10 a second (0.0 to 4.9 s)."""

from __future__ import annotations

from traps_pipeline.video.policies import fewest_within, shown_at_end


def test_the_frames_of_the_end_are_those_of_all_policies_together() -> None:
    # 5 a second: 4.4, 4.6, 4.8. Of 16 from 0 to 4.9, 0.327 s apart: 4.573 (4.6), 4.9. 2 a second: 4.5.
    assert shown_at_end(50, 10, 0.6) == [44, 45, 46, 48, 49]


def test_a_policy_without_a_frame_at_the_end_counts_with_its_last_one() -> None:
    # Of the last 0.1 s: 4.8 (5 a second), 4.9 (16 evenly spaced), and 4.5, the last of 2 a second.
    assert shown_at_end(50, 10, 0.1) == [45, 48, 49]


def test_an_event_between_two_frames_of_the_coarsest_policy_is_not_seen_under_all() -> None:
    assert fewest_within(50, 10, (21, 25)) == 0  # 2 a second shows 2.0 and 2.5 s; the second event is at 2.5 s
    assert fewest_within(50, 10, (20, 25)) == 1
    assert fewest_within(50, 10, (5, 21)) == 4  # 0.5, 1.0, 1.5, 2.0 s
