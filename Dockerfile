# The command `scenefuse` with the pinned versions, on CPUs. A project is mounted as /project:
#   docker build -t scenefuse . && docker run --rm -v "$PWD":/project scenefuse run --cores 2
FROM python:3.12-slim

# Libraries that the wheels of Open3D and OpenCV load, as in envs/setup.sh.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libgl1 libegl1 libx11-6 libusb-1.0-0 libidn2-0 libudev1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

COPY envs/requirements.txt /tmp/
RUN sed '/^# Development/,$d' /tmp/requirements.txt > /tmp/pinned.txt \
    && pip install --no-cache-dir "$(grep '^torch==' /tmp/pinned.txt)" --index-url https://download.pytorch.org/whl/cpu \
    && pip install --no-cache-dir -r /tmp/pinned.txt

COPY . /src
RUN pip install --no-cache-dir --no-deps --no-build-isolation /src && rm -rf /src

WORKDIR /project
ENTRYPOINT ["scenefuse"]
