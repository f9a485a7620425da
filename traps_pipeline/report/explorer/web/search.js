// Search by words: all of them must occur, in any order and place of an answer; "several words" in quotes are one.

function searchTerms(query) {
  return [...query.toLowerCase().matchAll(/"([^"]+)"|([^\s"]+)/g)].map(([, phrase, word]) => (phrase || word).trim());
}

// Whether each term occurs in one of the texts; null texts hold nothing.
function holdsAll(texts, terms) {
  const low = texts.filter(Boolean).map((text) => text.toLowerCase());
  return terms.every((term) => low.some((text) => text.includes(term)));
}

// The text, with its label, that holds most of the terms, and where the first of them stands in it.
function bestPlace(places, terms) {
  let best = { label: places[0][0], text: places[0][1], at: 0, count: 0 };
  for (const [label, text] of places) {
    if (!text) continue;
    const found = terms.map((term) => text.toLowerCase().indexOf(term)).filter((at) => at >= 0);
    if (found.length > best.count) best = { label, text, at: Math.min(...found), count: found.length };
  }
  return best;
}

// Parts of a text: [part, whether it is one of the terms]. The terms are in lower case.
function markedParts(text, terms) {
  const low = text.toLowerCase();
  // A letter whose lower case has another length would shift what is marked: then nothing is.
  if (!terms.length || low.length !== text.length) return [[text, false]];
  const parts = [];
  let from = 0;
  for (;;) {
    const hits = terms.map((term) => [low.indexOf(term, from), term]).filter(([at]) => at >= 0);
    if (!hits.length) return [...parts, [text.slice(from), false]];
    const [at, term] = hits.reduce((a, b) => (b[0] < a[0] || (b[0] === a[0] && b[1].length > a[1].length) ? b : a));
    parts.push([text.slice(from, at), false], [text.slice(at, at + term.length), true]);
    from = at + term.length;
  }
}
