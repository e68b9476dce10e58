"""The relaxed problem and its certificate: Newton, bound and gap."""
