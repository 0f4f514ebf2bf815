"""The windows: views know no session, presenters compute what is shown, nothing is stored twice."""
