// Pinocchio's rnea as C code that CasADi generates, for benchmarks/export.py.
#include <pinocchio/autodiff/casadi.hpp>

#include "pinocchio_loop.cpp"

// Writes the function `peer` of (q, v, a) into a file of the present folder.
extern "C" __attribute__((visibility("default"))) void arm_generate(Arm *arm, const char *file) {
  using casadi::SX;
  const auto model = arm->model.cast<SX>();
  pinocchio::DataTpl<SX> data(model);
  const int n = arm->model.nv;
  const SX q = SX::sym("q", n), v = SX::sym("v", n), a = SX::sym("a", n);
  using Vector = Eigen::Matrix<SX, Eigen::Dynamic, 1>;
  Vector x(n), y(n), z(n);
  for (int i = 0; i < n; ++i) {
    x[i] = q(i);
    y[i] = v(i);
    z[i] = a(i);
  }
  pinocchio::rnea(model, data, x, y, z);
  SX tau(n, 1);
  for (int i = 0; i < n; ++i) tau(i) = data.tau[i];
  casadi::Function("peer", {q, v, a}, {tau}).generate(file);
}
