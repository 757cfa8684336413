# hasrl_jax in a container, for CPUs or (--build-arg VARIANT=cuda) NVIDIA GPUs; docs/install.md has the commands.
# Dependencies come from docker/requirements-$VARIANT.lock, whose hashes pip checks. Not tried yet.
FROM python:3.11-slim-bookworm

ARG VARIANT=cpu
ENV PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 \
    NVIDIA_DRIVER_CAPABILITIES=all
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /src
COPY docker/requirements-${VARIANT}.lock requirements.lock
RUN pip install --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY configs configs
COPY hasrl_jax hasrl_jax
RUN pip install hatchling==1.33.0 && pip install --no-deps --no-build-isolation . && hasrl --version

# Whoever runs it (docker run --user) can write below /work, caches included.
RUN useradd --no-create-home hasrl && install -d -m 1777 /work
ENV HOME=/work
USER hasrl
WORKDIR /work
ENTRYPOINT ["hasrl"]
CMD ["doctor"]
