// What the explorer uses of its two libraries; `make explorer-vendor` bundles it into parquet.js.
export { parquetMetadata, parquetRead } from "hyparquet";
export { decompress as decompressZstandard } from "fzstd";
