# The package in a container. On a CPU:
#   docker build -t jaxid . && docker run --rm -v "$PWD:/work" jaxid demo -o demo
# On an NVIDIA GPU:
#   docker build --build-arg JAX=jax[cuda13] -t jaxid-gpu . && docker run --gpus all --rm -v "$PWD:/work" jaxid-gpu demo -o demo
ARG PYTHON=3.13
FROM python:${PYTHON}-slim
ARG JAX=jax
COPY . /source
RUN pip install --no-cache-dir "${JAX}" "/source[mujoco,logs]" && rm -r /source
WORKDIR /work
ENTRYPOINT ["jaxid"]
CMD ["demo"]
