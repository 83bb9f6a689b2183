#!/usr/bin/env bash
# Installs Chromium and its driver, which the tests of the report page need, on Debian. Called by `make test`; safe to
# call again. Where it may not or cannot, it says so, and those tests are skipped.
set -euo pipefail

if command -v chromedriver >/dev/null && { command -v chromium || command -v google-chrome; } >/dev/null; then
    exit 0
fi
install="apt-get update && apt-get install -y --no-install-recommends chromium chromium-driver"
if [ "$(id -u)" = 0 ]; then
    DEBIAN_FRONTEND=noninteractive bash -c "$install" && exit 0
elif sudo -n true 2>/dev/null; then
    sudo DEBIAN_FRONTEND=noninteractive bash -c "$install" && exit 0
fi
echo "note: the tests of the report page in a browser are skipped; to run them: sudo bash -c '$install'" >&2
