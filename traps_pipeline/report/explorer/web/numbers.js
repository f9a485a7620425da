// Numbers as the report prints them (traps_pipeline/report/writing.py).

const NONE = "–";
const NOT_RUN = "not run";

// A number with so many digits; halves go to the even digit, as in the report, and minus is a minus sign.
function fraction(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return NONE;
  let text = Math.abs(value).toFixed(digits);
  const rest = Math.abs(value)
    .toFixed(Math.min(100, digits + 60))
    .slice(digits ? text.length : text.length + 1);
  if (/^50*$/.test(rest) && Number(text.at(-1)) % 2) {
    text = text.slice(0, -1) + (Number(text.at(-1)) - 1); // toFixed rounds a half up; an odd digit is one too many
  }
  return value < 0 && Number(text) ? `−${text}` : text;
}

// A share (0 to 1) in percent, without the sign.
function percent(value, digits = 1) {
  return value === null || value === undefined ? NONE : fraction(100 * value, digits);
}

function count(value) {
  return Math.abs(value) < 10000 ? String(value) : String(value).replace(/\B(?=(\d{3})+$)/g, ",");
}

// A count with its noun, as `count_noun` of traps_pipeline/base/wording.py writes it.
function counted(number, singular, plural = `${singular}s`) {
  return `${count(number)} ${number === 1 ? singular : plural}`;
}

function pValue(value) {
  return value === null || value === undefined ? NONE : value < 1e-4 ? "< 0.0001" : fraction(value, 4);
}

// Two-sided exact binomial test of a against b with equal chances (McNemar): 1 where both are 0.
function mcnemar(a, b) {
  const n = a + b;
  if (a === b) return 1;
  const logOf = new Float64Array(n + 1); // of k!
  for (let k = 2; k <= n; k++) logOf[k] = logOf[k - 1] + Math.log(k);
  let tail = 0;
  for (let k = 0; k <= Math.min(a, b); k++) tail += Math.exp(logOf[n] - logOf[k] - logOf[n - k] - n * Math.LN2);
  return Math.min(1, 2 * tail);
}
