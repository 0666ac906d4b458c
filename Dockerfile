# docker build -t endopilot . && docker run --rm -it -p 8000:8000 -v "$PWD:/work" endopilot cockpit --no-browser --host 0.0.0.0 --port 8000
FROM python:3.12-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /src
WORKDIR /src
RUN python -m venv /opt/endopilot \
    && /opt/endopilot/bin/pip install --no-cache-dir -c constraints.txt . \
    && /opt/endopilot/bin/pip install --no-cache-dir -c constraints.txt 'endopilot[all]'

FROM python:3.12-slim
# libraries that VTK draws with off the screen
RUN apt-get update && apt-get install -y --no-install-recommends libgl1 libxrender1 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/endopilot /opt/endopilot
ENV PATH=/opt/endopilot/bin:$PATH
WORKDIR /work
ENTRYPOINT ["endopilot"]
CMD ["--help"]
