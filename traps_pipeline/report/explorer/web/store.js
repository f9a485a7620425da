// Data of the site: scripts that are added when they are needed, since a page on `file:` may not fetch.

const LOADS = new Map(); // name -> {promise, done, fail}
const VERSION = document.documentElement.dataset.version;
const DATA = document.documentElement.dataset.data;
const KEPT_SHARDS = 6;

// Every data script calls this.
globalThis.TRAPS_DATA = (name, version, content) => {
  const load = LOADS.get(name) || expect(name);
  if (version === VERSION) load.done(content);
  else load.fail(new Error(`data/${name}.js belongs to another version of this site: load the page again`));
};

function expect(name) {
  const load = {};
  load.promise = new Promise((done, fail) => Object.assign(load, { done, fail }));
  LOADS.set(name, load);
  return load;
}

// The content of a data script; it is asked for once. A script that cannot be read is asked for again the next time.
function content(name) {
  if (!LOADS.has(name)) {
    const load = expect(name);
    const script = h("script", { src: `${DATA}/${name}.js?v=${VERSION}` });
    script.onload = () => {
      script.remove();
      load.fail(new Error(`data/${name}.js holds no data`));
    };
    script.onerror = () => {
      script.remove();
      LOADS.delete(name);
      load.fail(
        new Error(`${DATA}/${name}.js cannot be read: copy the whole folder of the site, not index.html alone`),
      );
    };
    document.head.append(script);
  }
  return LOADS.get(name).promise;
}

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}

const COMPRESSORS = { ZSTD: (input, length) => trapsParquet.decompressZstandard(input, new Uint8Array(length)) };

// The columns of a Parquet file (base64) by name, and `length`.
async function columnsOf(base64) {
  const file = bytesOf(base64).buffer;
  const metadata = trapsParquet.parquetMetadata(file);
  const pieces = {};
  const onChunk = ({ columnName, columnData }) => (pieces[columnName] ||= []).push(columnData);
  await trapsParquet.parquetRead({ file, metadata, compressors: COMPRESSORS, onChunk });
  const columns = { length: Number(metadata.num_rows) };
  for (const { name } of metadata.schema.slice(1)) {
    const found = pieces[name] || [];
    columns[name] = found.length === 1 ? found[0] : found.flatMap((piece) => Array.from(piece));
  }
  return columns;
}

// The rows of a Parquet file as objects.
async function rowsOf(base64) {
  const { length, ...columns } = await columnsOf(base64);
  const names = Object.keys(columns);
  return Array.from({ length }, (_, k) => Object.fromEntries(names.map((name) => [name, columns[name][k]])));
}

function once(make) {
  let made = null;
  return () =>
    (made ||= make().catch((error) => {
      made = null;
      throw error;
    }));
}

const study = once(() => content("study"));

const contrasts = once(async () => rowsOf((await content("contrasts")).contrasts));
const regimeTests = once(async () => rowsOf((await content("regime_tests")).regime_tests));
const scenarios = once(
  async () => new Map((await content("scenarios")).scenarios.map((row) => [row.scenario_id, row])),
);

// All items and decisions (the outcomes of pairs are counted from these):
// items: columns; pairs: their dataset, scenario, family and the places of their items; of each answer (row) its item,
// evaluation, outcome, epoch, abstained, correct, unanimous; rowOf: the row of an item and evaluation, or -1.
const world = once(async () => {
  const info = await study();
  const [{ items: itemFile }, { decisions: file }] = await Promise.all([content("items"), content("decisions")]);
  const [items, decisions] = await Promise.all([columnsOf(itemFile), columnsOf(file)]);
  const width = info.evaluations.length;
  const rowOf = new Int32Array(items.length * width).fill(-1);
  for (let row = 0; row < decisions.length; row++) rowOf[decisions.item[row] * width + decisions.evaluation[row]] = row;
  const pairs = [];
  const pairOf = new Int32Array(items.length);
  const byId = new Map();
  for (let item = 0; item < items.length; item++) {
    const id = items.pair_id[item];
    if (!byId.has(id)) {
      byId.set(id, pairs.length);
      pairs.push({
        id,
        dataset: items.dataset[item],
        scenario: items.scenario_id[item],
        family: items.family[item],
        control: -1,
        void: -1,
      });
    }
    pairOf[item] = byId.get(id);
    pairs[pairOf[item]][items.side[item]] = item;
  }
  const found = { info, items, pairs, pairOf, byId, width, rowOf, decisions };
  found.pairOutcome = pairOutcomes(found);
  found.families = [...new Set(items.family)].sort();
  return found;
});

// --- texts and votes --------------------------------------------------------------------------------------------------

const SHARDS = new Map(); // number -> promise; the last ones used, oldest first

function shardOf(info, row) {
  let low = 0;
  let high = info.shards.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (info.shards[middle][1] <= row) low = middle;
    else high = middle - 1;
  }
  return low;
}

// Texts and votes of the answers of a shard: {first, texts: columns, votes: columns}.
async function shard(number) {
  if (!SHARDS.has(number)) SHARDS.set(number, readShard(number));
  const found = SHARDS.get(number);
  SHARDS.delete(number); // it becomes the youngest
  SHARDS.set(number, found);
  for (const oldest of SHARDS.keys()) if (SHARDS.size > KEPT_SHARDS) SHARDS.delete(oldest);
  return found;
}

async function readShard(number) {
  try {
    const [name, first] = (await study()).shards[number];
    const file = await content(name);
    LOADS.delete(name); // the text of the script is not kept, only what was read from it
    const [texts, votes] = await Promise.all([columnsOf(file.texts), columnsOf(file.votes)]);
    return { first, texts, votes };
  } catch (error) {
    SHARDS.delete(number);
    throw error;
  }
}

// The text, the reasoning, the votes and more of one answer.
async function answer(row) {
  const { first, texts, votes } = await shard(shardOf(await study(), row));
  const at = row - first;
  const cast = [];
  for (let k = lowerBound(votes.answer, at); k < votes.length && votes.answer[k] === at; k++) {
    cast.push(
      Object.fromEntries(
        Object.keys(votes)
          .filter((name) => name !== "length")
          .map((name) => [name, votes[name][k]]),
      ),
    );
  }
  const own = Object.keys(texts)
    .filter((name) => name !== "length")
    .map((name) => [name, texts[name][at]]);
  return { ...Object.fromEntries(own), votes: cast };
}

function lowerBound(sorted, value) {
  let low = 0;
  let high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}
