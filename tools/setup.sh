#!/usr/bin/env bash
# Sets everything up in .venv: tools/setup.sh [run|dev]. Done already, it returns at once and needs no network.
# Used by tools/demo.sh and tools/test.sh; there is no need to call it by hand.
set -euo pipefail

want=${1:-run} # run: what objslam needs; dev: also what its tests need
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
venv=$root/.venv
stamp=$venv/objslam-setup
key=$(cat "$root/pyproject.toml" "$root/tools/constraints.txt" | sha256sum | cut -d ' ' -f 1)

# Debian and Ubuntu packages, each with the library that says whether it is there.
needed="libusb-1.0-0=libusb-1.0.so.0 libgl1=libGL.so.1 libegl1=libEGL.so.1 libx11-6=libX11.so.6 libudev1=libudev.so.1 libgomp1=libgomp.so.1"

say() { echo "setup: $*" >&2; }
die() {
    say "$@"
    exit 1
}

# A virtual environment of this folder (a copied one points to where it came from) with a Python that still runs.
usable() {
    [ -x "$venv/bin/python" ] && grep -qF -- "$venv" "$venv/pyvenv.cfg" &&
        "$venv/bin/python" -c 'import importlib.util, sys; sys.exit(sys.version_info < (3, 11) or not importlib.util.find_spec("pip"))'
}

done_already() {
    local old_key old_want
    [ -f "$stamp" ] && usable && read -r old_key old_want <"$stamp" &&
        [ "$old_key" = "$key" ] && { [ "$old_want" = dev ] || [ "$want" = run ]; }
}

# The newest suitable Python that can make virtual environments (Debian packs that part separately).
find_python() {
    local name suitable=
    for name in python3.14 python3.13 python3.12 python3.11 python3; do
        "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null || continue
        suitable=${suitable:-$("$name" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')}
        if "$name" -c 'import ensurepip, venv' 2>/dev/null; then
            command -v "$name"
            return
        fi
    done
    if [ -n "$suitable" ]; then
        die "$suitable cannot make virtual environments here; type: sudo apt-get install $suitable-venv"
    fi
    die "no Python from 3.11 to 3.14 found; type: sudo apt-get install python3 python3-venv (or python3.11 python3.11-venv)"
}

# The packages among `package=library ...` whose library cannot be loaded.
missing_packages() {
    "$venv/bin/python" - "$@" <<'PYTHON'
import ctypes, sys
for package, library in (word.split("=") for word in sys.argv[1:]):
    try:
        ctypes.CDLL(library)
    except OSError:
        print(package)
PYTHON
}

# A picture of a recording without a screen needs Vulkan and some driver for it.
missing_for_screenshots() {
    missing_packages libvulkan1=libvulkan.so.1
    compgen -G '/usr/share/vulkan/icd.d/*.json' >/dev/null || compgen -G '/etc/vulkan/icd.d/*.json' >/dev/null || echo mesa-vulkan-drivers
}

# Installs packages with apt-get where that needs no question; fails, quietly, where it cannot.
apt_install() {
    local as_root=() log
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    say "installing $* with apt-get"
    log=$(mktemp)
    local install=("${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@")
    if "${install[@]}" >"$log" 2>&1 || { "${as_root[@]}" apt-get update -qq >>"$log" 2>&1 && "${install[@]}" >>"$log" 2>&1; }; then
        rm -f "$log"
    else
        grep '^E:' "$log" | sort -u >&2 || tail -n 5 "$log" >&2
        rm -f "$log"
        return 1
    fi
}

system_libraries() {
    local missing
    # shellcheck disable=SC2086 # a list of words
    missing=$(missing_packages $needed)
    # shellcheck disable=SC2086
    if [ -n "$missing" ] && ! apt_install $missing; then
        die "system libraries are missing; type: sudo apt-get install" $missing
    fi
    missing=$(missing_for_screenshots)
    # shellcheck disable=SC2086
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "screenshots of recordings will not work (the rest will); for them, type: sudo apt-get install" $missing
    fi
}

# pip would compile all modules of all packages. Python compiles those that are used, a fifth of them, when it first imports them.
pip_install() {
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile "$@"
}

# Prints the packages of one set in tools/constraints.txt, with the hashes of their files.
pinned() {
    awk -v want="$1" '/^# set: /{here = $3 == want; next} here' "$root/tools/constraints.txt"
}

# Installs the packages that it reads, in the very files that were tested, and nothing else. No package may be built here,
# because a build runs code that no hash covers.
install_pinned() {
    pip_install --require-hashes --no-deps --only-binary :all: --requirement /dev/stdin "$@"
}

# The ordinary torch brings several GB of CUDA. Without an NVIDIA GPU, take the CPU build, where it can be reached.
small_torch() {
    local index=https://download.pytorch.org/whl/cpu from=()
    [ "$(uname -s)" = Linux ] && [ ! -e /dev/nvidiactl ] || return 0
    if "$venv/bin/python" -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1] + "/torch/", timeout=5)' "$index" 2>/dev/null; then
        from=(--extra-index-url "$index")
    fi
    pinned run | awk '/^[^ ]/{here = /^torch==/} here' | sed 's/^torch==[^ ]*/&+cpu/' | install_pinned "${from[@]}" 2>/dev/null ||
        say "no CPU build of torch; taking the ordinary one"
}

# Whether the installed build of torch needs the packages of CUDA.
needs_cuda() {
    "$venv/bin/python" -c 'import importlib.metadata as m, sys; sys.exit(not any("nvidia" in r for r in m.requires("torch") or ()))'
}

# pip uses one core. So torch, the largest package, is installed beside the others, and while the packages of the tests are
# installed, Python imports large ones for the first time, which compiles them. That takes seconds.
install_all() {
    small_torch &
    pinned run | awk '/^[^ ]/{here = !/^torch==/} here' | install_pinned || { wait; return 1; }
    wait
    pinned run | install_pinned || return # torch, if there was no CPU build of it
    if needs_cuda; then pinned cuda | install_pinned || return; fi
    if [ "$want" = dev ]; then
        "$venv/bin/python" -c 'import open3d, rerun, scipy.stats, torch' >/dev/null 2>&1 &
        { pinned dev; pinned docs; } | install_pinned || { wait; return 1; }
        wait
    fi
    pip_install --no-index --no-deps --no-build-isolation --editable "$root" &&
        "$venv/bin/python" -m pip check --disable-pip-version-check >&2
}

case $want in run | dev) ;; *) die "use: tools/setup.sh [run|dev]" ;; esac
done_already && exit 0
if ! usable; then
    python=$(find_python)
    say "making .venv with $python"
    "$python" -m venv --clear "$venv"
fi
rm -f "$stamp"
system_libraries
say "installing objslam and what it needs into .venv (the first time, this takes some minutes)"
install_all || die "pip could not install everything: see above (the network is needed for the first set-up)"
problem=$("$venv/bin/python" -c 'import open3d' 2>&1) || die "Open3D cannot be imported: $(tail -n 1 <<<"$problem")"
echo "$key $want" >"$stamp"
say "done"
