//! Simulated light, cameras and HSU: real protocols, simulated photons.
