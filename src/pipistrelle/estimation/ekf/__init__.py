"""EKF-SLAM: `filter` corrects one Gaussian over pose and map; `gaussian` holds its kernels."""
