"""EKF-SLAM: `filter` updates a Gaussian over pose and map; `gaussian` holds its kernels."""
