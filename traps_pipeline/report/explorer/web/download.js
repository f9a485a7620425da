// Tables as CSV files, and addresses for the clipboard.

// A table as CSV: texts may come from models, so none is a formula for a spreadsheet (as base/sheets.py).
function csvOf(heads, rows) {
  const cell = (value) => {
    let text = value === null || value === undefined ? "" : String(value);
    if (typeof value === "string" && /^[=+\-@\t\r]/.test(text)) text = `'${text}`;
    return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return [heads, ...rows].map((row) => row.map(cell).join(",")).join("\n") + "\n";
}

function save(name, text) {
  const address = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  h("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}

// Copy the address of this view; where the browser does not allow it, show it selected until something else is done.
async function copyAddress(button) {
  try {
    await navigator.clipboard.writeText(location.href);
  } catch {
    const field = h("input", { value: location.href, readonly: true, "aria-label": "address of this view" });
    field.addEventListener("blur", () => field.replaceWith(button)); // the next view has another address
    button.replaceWith(field);
    field.select();
    return;
  }
  // An address of this disk opens nothing elsewhere.
  button.textContent = location.protocol === "file:" ? "Copied: send this folder, too" : "Copied";
  setTimeout(() => (button.textContent = "Copy link"), 2500);
}
