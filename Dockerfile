# warpav on CPUs: docker build -t warpav . && docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" warpav optimise
FROM python:3.11-slim

# OpenGL without a display, for the 3D figures
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri && rm -rf /var/lib/apt/lists/*

COPY . /src
RUN pip install --no-cache-dir "/src[cad]" && rm -rf /src

# compiled kernels, scenes and pools are kept here, for any user
ENV HOME=/cache
RUN useradd --home-dir /cache warpav && mkdir -m 1777 /cache && mkdir /work && chown warpav /work
VOLUME /cache
USER warpav
WORKDIR /work
ENTRYPOINT ["warpav"]
CMD ["--help"]
