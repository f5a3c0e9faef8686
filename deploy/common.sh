# Functions of deploy/demo and deploy/check that install or name missing dependencies. Source it from the root folder.

say() { printf '\033[1m== %s\033[0m\n' "$*" >&2; }
refuse() { printf 'modalcast: %s\n' "$*" >&2; exit 1; }
# No `grep -q`: it closes the pipe at the first match, and pipefail reports the broken pipe of ldconfig as a failure.
has_library() { /sbin/ldconfig -p 2>/dev/null | grep -F "$1" >/dev/null; }

# Installs Debian packages as root; otherwise stops and names them.
need_packages() {
    local missing=()
    for package in "$@"; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && return
    command -v apt-get >/dev/null || refuse "please install what your system calls: ${missing[*]}"
    [ "$(id -u)" -eq 0 ] || refuse "please install: sudo apt-get install ${missing[*]}"
    say "Installing ${missing[*]}"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

# Stops if the Rust toolchain is missing or too old, and prints the command that installs it. The toolchain belongs to
# the user, so it is not installed here.
need_rust() {
    local wanted found
    wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
    local remedy="curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y --default-toolchain stable"
    # A shell that was started before the installation does not have the toolchain in its PATH.
    command -v cargo >/dev/null || PATH="$HOME/.cargo/bin:$PATH"
    command -v cargo >/dev/null && command -v rustc >/dev/null ||
        refuse "Rust $wanted or newer is needed and none was found. Install it with:
    $remedy"
    found=$(rustc --version | awk '{print $2}')
    [ "$(printf '%s\n%s\n' "$wanted" "$found" | sort -V | head -n 1)" = "$wanted" ] ||
        refuse "Rust $wanted or newer is needed, $found was found. Update it with: rustup update stable, or:
    $remedy"
    command -v cc >/dev/null || need_packages gcc libc6-dev
}

# OpenGL through EGL: NVIDIA's driver includes its vendor library; Mesa's library renders on the CPU.
need_egl() {
    has_library 'libEGL.so.1' || need_packages libegl1
    has_library 'libEGL_nvidia.so.0' && return 0
    has_library 'libEGL_mesa.so.0' || need_packages libegl-mesa0
    # The folder of Mesa's drivers differs between systems; require Debian's package only if no driver is found.
    compgen -G '/usr/lib/*/dri/swrast_dri.so' >/dev/null || compgen -G '/usr/lib*/dri/swrast_dri.so' >/dev/null ||
        need_packages libgl1-mesa-dri
}

# Installs NVRTC from its PyPI wheel into a git-ignored folder that the server searches.
need_nvrtc() {
    compgen -G '.tools/nvrtc/nvidia/*/lib/libnvrtc.so.13' >/dev/null && return
    command -v python3 >/dev/null && python3 -m pip --version >/dev/null 2>&1 || need_packages python3 python3-pip
    say "Installing NVRTC (PyPI nvidia-cuda-nvrtc) into .tools/nvrtc"
    python3 -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
        --target .tools/nvrtc 'nvidia-cuda-nvrtc==13.0.88'
}

# Installs NVRTC only if the machine has an NVIDIA driver and no NVRTC; without a driver it is not needed.
need_nvrtc_for_driver() {
    has_library 'libcuda.so.1' || return 0
    has_library 'libnvrtc.so.13' && return 0
    need_nvrtc
}
