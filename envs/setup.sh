#!/usr/bin/env bash
# Makes the default environment in .venv, on Debian or Ubuntu. Called by `make`; safe to call again.
set -euo pipefail
cd "$(dirname "$0")/.."

PACKAGES=(python3-venv libgl1 libegl1 libx11-6 libusb-1.0-0 libidn2-0 libudev1 libgomp1)
PYTHON=${PYTHON:-python3}

if ! "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    echo "error: Python 3.11 or newer is needed, and '$PYTHON' is not; install one and run: make PYTHON=/path/to/python3" >&2
    exit 1
fi

# System libraries that the wheels of Open3D and OpenCV load; Open3D needs them even to read a file.
missing=()
for package in "${PACKAGES[@]}"; do
    case $package in
        python3-venv) "$PYTHON" -c 'import ensurepip' 2>/dev/null || missing+=("$package") ;;
        # Ubuntu 24.04 renamed some of them with a t64 suffix.
        *) [[ $(dpkg-query -W -f '${Status}\n' "$package" "${package}t64" 2>/dev/null || true) == *"ok installed"* ]] || missing+=("$package") ;;
    esac
done
if [ ${#missing[@]} -gt 0 ]; then
    install="apt-get update && apt-get install -y --no-install-recommends ${missing[*]}"
    if [ "$(id -u)" = 0 ]; then
        DEBIAN_FRONTEND=noninteractive bash -c "$install"
    elif sudo -n true 2>/dev/null; then
        sudo DEBIAN_FRONTEND=noninteractive bash -c "$install"
    else
        echo "error: system packages are missing; run this once, then make again:" >&2
        echo "    sudo bash -c '$install'" >&2
        exit 1
    fi
fi

[ -x .venv/bin/python ] || "$PYTHON" -m venv .venv
.venv/bin/python -m pip install --quiet --disable-pip-version-check -r envs/requirements.txt
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
