"""Share the printed titles and marks, and the names of a pair's sides, between tables, figures and pages."""

from traps_pipeline.protocol.datasets import ARMS, GRADED, TWO_EVENTS, VARIATIONS
from traps_pipeline.protocol.metric_words import METRIC_WORDS, SHARES
from traps_pipeline.scoring.score_rows import BROKEN_ABOVE, INCOMPLETE_BELOW

TITLE_OF = {
    "overall": "Overall",
    "occlusion": "Occlusion",
    "occlusion_ill_posed": "Occlusion, ill-posed",
    "chaotic": "Chaotic",
    "chaotic_ill_posed": "Chaotic, ill-posed",
}
# Neither arms nor variations enter a metric of the pairs.
ARM_TITLES = {arm: f"Arm: {arm.replace('_', ' ')}" for arm in ARMS}
ARM_TITLES |= {TWO_EVENTS: "Two events", GRADED: "Graded cuts"}
ARM_TITLES |= {name: f"Variation: {name.replace('_', ' ')}" for name in VARIATIONS}
# Headings and meanings of the metrics of two events on the leaderboard (docs/scoring.md, "Two events").
TWO_WAY_MEANINGS = {
    "Conjunction %": "share of scenarios of two events with all eight items right; 0 for every rule of clip or "
    "question alone, for always and for never abstaining",
    "Specificity": "by how much more abstention rises where the asked event is hidden than where the other one is, −1 "
    "to 1; 0 for every rule of clip or question alone, 1 for an oracle",
}
# The side whose items a share counts.
SIDE_OF = {name: METRIC_WORDS[name].side for name in SHARES}
ENOUGH = f"{100 * INCOMPLETE_BELOW:g} %"
MISSING_MARK = "†"
INCOMPLETE_MARK = "‡"
BROKEN_MARK = "§"
OVERRULED_MARK, OVERRULED_ABOVE = "¶", 0.01
BROKEN_TEXTS = (
    f"more than {100 * BROKEN_ABOVE:g} % of the texts are empty, degenerate, unread, unfinished or cut off before an "
    "answer"
)
MARKS = {
    MISSING_MARK: "some items have no answer or no majority; shares are over the other items",
    INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered",
    BROKEN_MARK: f"broken: {BROKEN_TEXTS}",
    OVERRULED_MARK: "code decides otherwise than some judge's own word on more than 1 % of the controls",
}
# Terms of mechanistic tables and figures; a page without these does not explain them.
INSIDE_TERMS = {
    "oc, ch, _ip": "the datasets occlusion and chaotic, with _ip their ill-posed questions; oc→ch: learnt from oc and "
    "applied to ch",
    "States": "numbers inside the model at one layer: layer 0 is the embeddings, layer l what block l hands on",
    "AUROC": "chance that a probe scores a void above a control: 1 tells all apart, 0.5 is guessing, 0 is always wrong",
    "Output margin": "log-odds that the first answer token begins an abstention",
    "Class gap": "distance between the mean states of voids and of controls at a layer",
    "Indirect effect": "share of the difference between the answers to both sides that goes over with patched states",
    "† inside models": "from fewer than ten items a side",
}
