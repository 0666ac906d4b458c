#include <nanobind/nanobind.h>

NB_MODULE(_core, module) { module.doc() = "The Cosserat rod core of endopilot."; }
