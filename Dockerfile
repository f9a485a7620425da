# The demo, or any study, in a container. Not built: no container engine was at hand when it was written. Its RUN lines ran
# as they stand in a bare chroot of the same Debian, with a mirror in place of the snapshot, which could not be reached.
#
#   docker build -t trapsbench .
#   docker run --rm -v "$PWD/studies:/studies" trapsbench run demo
#
# To begin from the same bytes every time, name the base by its digest: --build-arg BASE=debian@sha256:...
ARG BASE=debian:bookworm-slim
FROM ${BASE} AS base
# Packages as they were on that day. Mesa draws the clips, and another version of it may draw other pixels: it is named
# exactly, so that a build fails rather than draw with another one.
ARG SNAPSHOT=20261115T000000Z
ARG MESA=22.3.6-1+deb12u2
RUN rm -rf /etc/apt/sources.list.d/* \
 && echo "deb [check-valid-until=no] http://snapshot.debian.org/archive/debian/${SNAPSHOT} bookworm main" > /etc/apt/sources.list \
 && apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends python3 python3-venv make "libosmesa6=${MESA}" "libglapi-mesa=${MESA}" \
 && rm -rf /var/lib/apt/lists/*

FROM base
COPY . /source
RUN python3 -m venv /opt/traps \
 && /opt/traps/bin/pip install --no-cache-dir --no-deps --require-hashes -r /source/requirements-core.lock \
 && cd /source && /opt/traps/bin/python -m hatchling build -t wheel -d /wheel \
 && /opt/traps/bin/pip install --no-deps --no-index /wheel/*.whl \
 && rm -rf /source
ENV PATH=/opt/traps/bin:$PATH TRAPS_WORKSPACE=/studies/default
WORKDIR /studies
ENTRYPOINT ["traps"]
CMD ["--help"]
