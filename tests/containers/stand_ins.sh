#!/bin/sh
# Stand-ins for the images of others that the Dockerfile and the compose file name, for a machine with a container engine that
# reaches Debian's packages and PyPI but no hub of images. They carry the same names, so nothing else changes; what they hold
# are Debian's Python, Redis and PostgreSQL, the `weed` of this environment, and the wheels that `docker build` installs, so
# that the build needs no network.
#
# usage, as root, with a debootstrap on the path:   sh tests/containers/stand_ins.sh FOLDER
set -eu
cd "$(dirname "$0")/../.."
folder=$1
python=${PYTHON:-.venv/bin/python}
mkdir -p "$folder/wheels" "$folder/context"

name_of() { grep -ohE "(image: |FROM )$1:[^ ]+" docker/Dockerfile docker-compose.yml | head -1 | sed 's/.* //'; }

test -e "$folder/root/.complete" || {
    debootstrap --variant=minbase \
        --include=python3,python3-venv,python3-pip,redis-server,postgresql,wget,ca-certificates,libgomp1,procps \
        bookworm "$folder/root"
    touch "$folder/root/.complete"
}
"$python" -m pip download -q -d "$folder/wheels" -c docker/constraints.txt '.[api,postgres,worker,gpu]' \
    'setuptools>=77,<90' wheel async-timeout # Debian's Python is older than that of the image, and asks for the last one

tar -C "$folder/root" --exclude=./proc --exclude=./sys --exclude=./dev --exclude=./var/cache/apt --exclude=./var/lib/apt -cf - . \
    | docker import - graspd-stand-in:debian
cp -r "$folder/wheels" "$folder/context/"
cp .venv/bin/weed "$folder/context/"
cat > "$folder/context/postgres" <<'EOF'
#!/bin/sh
# What of the official image's start the compose file uses.
set -eu
bin=$(echo /usr/lib/postgresql/*/bin)
export PGDATA=/var/lib/postgresql/data
chown postgres "$PGDATA" && chmod 700 "$PGDATA"
as() { setpriv --reuid=postgres --regid=postgres --init-groups "$@"; }
if ! test -s "$PGDATA/PG_VERSION"; then
    echo "$POSTGRES_PASSWORD" > /tmp/password && chown postgres /tmp/password
    as "$bin/initdb" -U "$POSTGRES_USER" -E UTF8 -A scram-sha-256 --pwfile=/tmp/password > /dev/null
    echo "host all all all scram-sha-256" >> "$PGDATA/pg_hba.conf"
    as "$bin/pg_ctl" -w start -o "-c listen_addresses=''" > /dev/null
    PGPASSWORD=$POSTGRES_PASSWORD "$bin/createdb" -h /var/run/postgresql -U "$POSTGRES_USER" "$POSTGRES_DB"
    as "$bin/pg_ctl" -w stop > /dev/null
fi
exec setpriv --reuid=postgres --regid=postgres --init-groups "$bin/postgres" -c listen_addresses='*'
EOF
chmod +x "$folder/context/postgres"

stand_in() { # name, then the Dockerfile's lines
    { echo "FROM graspd-stand-in:debian"; cat; } > "$folder/context/Dockerfile"
    docker build -q -t "$1" "$folder/context"
}
stand_in "$(name_of python)" <<'EOF'
COPY wheels /wheels
RUN ln -s /usr/bin/python3 /usr/local/bin/python && printf '[global]\nno-index = true\nfind-links = /wheels\n' > /etc/pip.conf
EOF
stand_in "$(name_of redis)" <<'EOF'
CMD ["redis-server"]
EOF
stand_in "$(name_of postgres)" <<'EOF'
COPY postgres /usr/local/bin/start
RUN ln -s /usr/lib/postgresql/*/bin/pg_isready /usr/local/bin/pg_isready || true
ENTRYPOINT ["start"]
EOF
stand_in "$(name_of chrislusf/seaweedfs)" <<'EOF'
COPY weed /usr/local/bin/weed
EOF
