"""HEIDENHAIN TNC: .COM/.CMA tables (heidenhain-com), KinematicsComp as a draft (heidenhain-kinematics)."""
