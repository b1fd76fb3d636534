// Pinocchio in a plain C++ loop over samples, for benchmarks/peers.py.
#include <pinocchio/algorithm/regressor.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>

using Row = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

struct Arm {
  pinocchio::Model model;
  pinocchio::Data data;
};

// Per joint: the parent (-1 is the ground), rotation (by rows), offset, axis, and mass, centre of
// mass, rotational inertia about it (by rows).
extern "C" __attribute__((visibility("default"))) Arm *arm_new(
    int joints, const int *parent, const double *rotation, const double *offset,
    const double *axis, const double *bodies) {
  pinocchio::Model model;
  for (int i = 0; i < joints; ++i) {
    const Eigen::Matrix3d R = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(rotation + 9 * i);
    const Eigen::Vector3d r = Eigen::Map<const Eigen::Vector3d>(offset + 3 * i);
    const Eigen::Vector3d a = Eigen::Map<const Eigen::Vector3d>(axis + 3 * i);
    const double *b = bodies + 13 * i;
    const Eigen::Vector3d c = Eigen::Map<const Eigen::Vector3d>(b + 1);
    const Eigen::Matrix3d J = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(b + 4);
    const pinocchio::SE3 place(R, r);
    const std::string name = "joint" + std::to_string(i);
    const auto above = static_cast<pinocchio::JointIndex>(parent[i] + 1);
    pinocchio::JointIndex id;
    if (a == Eigen::Vector3d::UnitZ())
      id = model.addJoint(above, pinocchio::JointModelRZ(), place, name);
    else if (a == Eigen::Vector3d::UnitY())
      id = model.addJoint(above, pinocchio::JointModelRY(), place, name);
    else if (a == Eigen::Vector3d::UnitX())
      id = model.addJoint(above, pinocchio::JointModelRX(), place, name);
    else
      id = model.addJoint(above, pinocchio::JointModelRevoluteUnaligned(a), place, name);
    model.appendBodyToJoint(id, pinocchio::Inertia(b[0], c, J));
  }
  return new Arm{model, pinocchio::Data(model)};
}

extern "C" __attribute__((visibility("default"))) void arm_delete(Arm *arm) { delete arm; }

extern "C" __attribute__((visibility("default"))) void arm_regressors(
    Arm *arm, long samples, const double *q, const double *v, const double *a, double *out) {
  const int n = arm->model.nv;
  for (long k = 0; k < samples; ++k) {
    const Eigen::Map<const Eigen::VectorXd> qk(q + n * k, n), vk(v + n * k, n), ak(a + n * k, n);
    Eigen::Map<Eigen::MatrixXd>(out + 10 * n * n * k, n, 10 * n) =
        pinocchio::computeJointTorqueRegressor(arm->model, arm->data, qk, vk, ak);
  }
}

extern "C" __attribute__((visibility("default"))) void arm_torques(
    Arm *arm, long samples, const double *q, const double *v, const double *a, double *out) {
  const int n = arm->model.nv;
  for (long k = 0; k < samples; ++k) {
    const Eigen::Map<const Eigen::VectorXd> qk(q + n * k, n), vk(v + n * k, n), ak(a + n * k, n);
    Eigen::Map<Eigen::VectorXd>(out + n * k, n) = pinocchio::rnea(arm->model, arm->data, qk, vk, ak);
  }
}
