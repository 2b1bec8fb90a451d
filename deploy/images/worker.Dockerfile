# Workers, their scheduler and the simulated dome: all stages, with the libLLVM that the renderer compiles with.
FROM python:3.12-slim-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends libatomic1 libllvm19 && rm -rf /var/lib/apt/lists/* \
 && useradd --uid 10001 --create-home dentine && install -d -o dentine -g dentine /data
WORKDIR /app
COPY pyproject.toml README.md ./
COPY services services
RUN pip install --no-cache-dir '.[postgres,capture,preprocess,fit]'
USER dentine
VOLUME /data
CMD ["dask", "worker", "tcp://scheduler:8786"]
