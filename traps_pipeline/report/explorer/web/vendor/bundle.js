// Bundles entry.js into the classic script parquet.js, with both licences at its top, and notes its digest in
// parquet.js.sha256. Run `make explorer-vendor` after a version in package.json was changed.
const { createHash } = require("node:crypto");
const { readFileSync, writeFileSync } = require("node:fs");
const { buildSync } = require("esbuild");

const libraries = ["hyparquet", "fzstd"].map((name) => {
  const { version } = JSON.parse(readFileSync(`node_modules/${name}/package.json`, "utf8"));
  const licence = readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim();
  return `${name} ${version}\n\n${licence}`;
});
const built = buildSync({
  entryPoints: ["entry.js"],
  bundle: true,
  minify: true,
  format: "iife",
  globalName: "trapsParquet",
  target: "es2020",
  charset: "ascii",
  write: false,
});
const script = `/*\n${libraries.join("\n\n")}\n*/\n${built.outputFiles[0].text}`;
writeFileSync("parquet.js", script);
writeFileSync("parquet.js.sha256", `${createHash("sha256").update(script).digest("hex")}  parquet.js\n`);
