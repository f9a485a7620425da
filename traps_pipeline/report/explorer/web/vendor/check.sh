#!/bin/sh
# Types and style of all scripts; `make explorer-check` runs it where tsc and eslint are on the path.
set -e
cd "$(dirname "$0")"
tsc -p tsconfig.json
for page in review annotate; do # each page is a scope of its own
  tsc --ignoreConfig --allowJs --checkJs --noEmit --strict false --target esnext --lib esnext,dom,dom.iterable \
    globals.d.ts ../dom.js ../keys.js ../search.js ../player.js \
    ../../../../servers/web/listening.js "../../../../servers/web/$page.js"
done
cd ../../../..
eslint --config report/explorer/web/vendor/eslint.config.mjs report/explorer/web servers/web
