// What became of a pair and of an answer, from the panel's decisions.

const NO = 0;
const YES = 1; // of a decision; 2: not judged, or no majority

// Outcomes of a pair under one evaluation. Acc counts the first two, AbsRec the first, third and fourth.
const OUTCOMES = [
  { id: "right", title: "Both right", meaning: "the control is answered correctly, the void is abstained on" },
  {
    id: "confabulated",
    title: "Confabulated",
    meaning: "the control is answered correctly, and the void is answered too",
  },
  { id: "cautious", title: "Over-cautious", meaning: "the void is abstained on, and the control as well" },
  { id: "mistaken", title: "Control wrong", meaning: "the void is abstained on, the control is answered wrongly" },
  { id: "wrong", title: "Both wrong", meaning: "the control is not answered correctly, and the void is answered" },
  { id: "missing", title: "Missing", meaning: "an answer, or a majority on it, is missing on one side" },
];
const MISSING = 5;

function pairOutcome(decisions, control, empty) {
  if (control < 0 || empty < 0) return MISSING;
  const [correct, cautious, abstained] = [
    decisions.correct[control],
    decisions.abstained[control],
    decisions.abstained[empty],
  ];
  if (correct > YES || cautious > YES || abstained > YES) return MISSING;
  if (correct === YES) return abstained === YES ? 0 : 1;
  if (abstained === NO) return 4;
  return cautious === YES ? 2 : 3;
}

// The outcome of every pair and evaluation: pairs x evaluations; 255 where the pair was not asked, or has one side.
function pairOutcomes({ pairs, width, rowOf, decisions }) {
  const found = new Uint8Array(pairs.length * width).fill(255);
  pairs.forEach((pair, p) => {
    if (pair.control < 0 || pair.void < 0) return;
    for (let e = 0; e < width; e++) {
      const [control, empty] = [rowOf[pair.control * width + e], rowOf[pair.void * width + e]];
      if (control >= 0 || empty >= 0) found[p * width + e] = pairOutcome(decisions, control, empty);
    }
  });
  return found;
}

// How many pairs (over these evaluations) have each outcome.
function countOutcomes({ pairOutcome: of, width }, pairs, evaluations) {
  const counts = new Array(OUTCOMES.length).fill(0);
  for (const p of pairs)
    for (const e of evaluations) if (of[p * width + e] < OUTCOMES.length) counts[of[p * width + e]]++;
  return counts;
}

// The places of evaluations that have this model, regime and run; an empty value fits all.
function evaluationsOf(info, { model = "", regime = "", run = "" }) {
  const fits = ([m, r, n]) => (!model || m === model) && (!regime || r === regime) && (!run || n === Number(run));
  return info.evaluations.flatMap((each, place) => (fits(each) ? [place] : []));
}

function pairsOf({ pairs }, { dataset = "", family = "" }) {
  const fits = (pair) => (!dataset || pair.dataset === dataset) && (!family || pair.family === family);
  return pairs.flatMap((pair, place) => (fits(pair) ? [place] : []));
}

// The panel's decision on one answer, in words: [text, kind of chip].
function decisionWords(info, items, decisions, row) {
  if (row < 0) return [NOT_RUN, "missing"];
  const outcome = info.outcomes[decisions.outcome[row]];
  if (!info.judged.includes(outcome)) return [outcome, "missing"];
  const isControl = items.side[decisions.item[row]] === "control";
  const [abstained, correct] = [decisions.abstained[row], decisions.correct[row]];
  if (abstained > YES) return ["undecided", "missing"];
  if (!isControl) return abstained === YES ? ["abstained", "right"] : ["answered", "confabulated"];
  if (correct > YES)
    return [abstained === YES ? "abstained, correctness undecided" : "answered, correctness undecided", "missing"];
  if (abstained === YES) return [correct === YES ? "abstained, yet correct" : "abstained", "cautious"];
  return correct === YES ? ["correct", "right"] : ["wrong", "wrong"];
}
