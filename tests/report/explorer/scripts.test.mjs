// Unit tests of the explorer's functions without a page; `node --test` runs them (tests/report/explorer/test_scripts.py).
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import vm from "node:vm";

const WEB = new URL("../../../traps_pipeline/report/explorer/web/", import.meta.url);
const SOURCES = ["numbers.js", "search.js", "download.js", "outcomes.js", "landscape.js", "cases.js", "parts.js"];
const NAMES = "{ searchTerms, holdsAll, bestPlace, markedParts, csvOf, counted, fraction, mcnemar, casesOf, modelsFirst, withHeading, spreadLabels, countOutcomes, pairOutcomes }";
const source = SOURCES.map((name) => readFileSync(new URL(name, WEB), "utf8")).join("\n");
const page = vm.runInNewContext(`${source}\n;(${NAMES})`);
const plain = (value) => JSON.parse(JSON.stringify(value)); // arrays of another realm are of another class

test("words are sought in any order, what stands in quotes together", () => {
  assert.deepEqual(plain(page.searchTerms('Final "not KNOW"  answer')), ["final", "not know", "answer"]);
  const texts = ["The answer: I do not know.", null, "A judge says: final"];
  assert.equal(page.holdsAll(texts, ["final", "not know", "answer"]), true);
  assert.equal(page.holdsAll(texts, ["know not"]), false);
  assert.equal(page.holdsAll([null], ["a"]), false);
});

test("the excerpt is of the text that holds most words, at the first of them", () => {
  const places = [["", "left"], ["reasoning: ", "it rolls left, then right"], ["judge: ", null]];
  assert.deepEqual(plain(page.bestPlace(places, ["right", "left"])), {
    label: "reasoning: ", text: "it rolls left, then right", at: 9, count: 2,
  });
  assert.equal(page.bestPlace(places, []).text, "left");
});

test("a count agrees with its noun", () => {
  const texts = [0, 1, 12345].map((number) => page.counted(number, "entry", "entries"));
  assert.deepEqual(plain(texts), ["0 entries", "1 entry", "12,345 entries"]);
  assert.equal(page.counted(1, "clip"), "1 clip");
});

test("all words are marked, the longer one where two begin alike", () => {
  assert.deepEqual(plain(page.markedParts("Not known, not so", ["not", "not known"])), [
    ["", false], ["Not known", true], [", ", false], ["not", true], [" so", false],
  ]);
  assert.deepEqual(plain(page.markedParts("İx x", ["x"])), [["İx x", false]]); // lower case is longer
});

test("a CSV quotes what has to be quoted, and no text is a formula", () => {
  const rows = [['say "a", b', "=1+1", -1.5], ["two\nlines", null, 0]];
  assert.equal(page.csvOf(["a", "b", "c"], rows), 'a,b,c\n"say ""a"", b",\'=1+1,-1.5\n"two\nlines",,0\n');
});

test("numbers are printed as in the report", () => {
  assert.deepEqual([0.0625, -0.0004, -0.0625, null].map((value) => page.fraction(value)), ["0.062", "0.000", "−0.062", "–"]);
  assert.equal(page.mcnemar(0, 5), 2 / 32);
});

test("labels of the landscape stay apart, in order and inside", () => {
  const at = plain(page.spreadLabels([100, 100, 101, 400], 17, 20, 410));
  assert.deepEqual(at, [100, 117, 134, 400]);
  assert.deepEqual(plain(page.spreadLabels([405, 409], 17, 20, 410)), [393, 410]);
});

test("reference rows come last, below a heading, in the order of their sort", () => {
  const info = { models: [{ id: "oracle", group: "reference" }, { id: "a", group: "main" }, { id: "b", group: "own" }] };
  const items = [{ model: "oracle", n: 1 }, { model: "b" }, { model: "oracle", n: 2 }, { model: "a" }];
  const sorted = page.modelsFirst(info, items);
  assert.deepEqual(plain(sorted).map(({ model, n }) => [model, n ?? 0]), [["b", 0], ["a", 0], ["oracle", 1], ["oracle", 2]]);
  assert.deepEqual(plain(page.withHeading(info, sorted, [1, 2, 3, 4])), [1, 2, ["Reference rows"], 3, 4]);
  assert.deepEqual(plain(page.withHeading(info, sorted.slice(0, 2), [1, 2])), [1, 2]);
});

// A study of one scene with a visual and a textual pair; an answer is yes (abstained), no, or null (not decided).
function study(answers) {
  const evaluations = [["thinks", "standard", 1], ["thinks", "guided", 1], ["speaks", "standard", 1]];
  const sides = ["visual control", "visual void", "textual control", "textual void"];
  const rowOf = new Int32Array(sides.length * evaluations.length).fill(-1);
  const abstained = [];
  for (const [key, value] of Object.entries(answers)) {
    const [side, evaluation] = key.split(", ");
    const name = evaluations.findIndex((each) => each.slice(0, 2).join(" ") === evaluation);
    rowOf[sides.indexOf(side) * evaluations.length + name] = abstained.length;
    abstained.push(value === null ? 2 : Number(value));
  }
  const pairs = [
    { dataset: "chaotic", scenario: "plinko-0001", control: 0, void: 1 },
    { dataset: "chaotic_ill_posed", scenario: "plinko-0001", control: 2, void: 3 },
  ];
  const info = { evaluations, titles: { chaotic: "", chaotic_ill_posed: "" }, reasoning_pairs: [["thinks", "speaks"]] };
  return { info, pairs, width: evaluations.length, rowOf, decisions: { abstained } };
}

test("a case is what the paper describes, and nothing else is", () => {
  const kinds = ["inverted", "flipped", "textual", "thinking"];
  const found = (answers) => kinds.filter((kind) => page.casesOf(study(answers), kind).length);
  const answered = { "visual void, thinks standard": false };
  assert.deepEqual(found({ ...answered, "visual control, thinks standard": true }), ["inverted"]);
  assert.deepEqual(found({ ...answered, "visual void, thinks guided": true }), ["flipped"]);
  assert.deepEqual(found({ ...answered, "textual void, thinks standard": true }), ["textual"]);
  assert.deepEqual(found({ ...answered, "visual void, speaks standard": true }), ["thinking"]);
  assert.deepEqual(found({ ...answered, "visual control, thinks standard": null }), []);
  assert.deepEqual(found({ ...answered, "visual control, thinks guided": true }), []); // another regime's control
  assert.deepEqual(found({ "visual void, thinks standard": true, "visual void, thinks guided": false }), []);
  assert.deepEqual(plain(page.casesOf(study({ ...answered, "textual void, thinks standard": true }), "textual")), [
    { pair: 0, left: 0, right: 0, other: 1 },
  ]);
});
